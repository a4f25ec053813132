"""The same on a GPU: the kernels, what they are given, and the choice of the device."""
