"""The only code that touches hardware, a simulator or files of a data set."""
