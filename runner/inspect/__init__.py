"""What a recording or a step tells people."""
