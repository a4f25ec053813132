"""What travels between processes: its bytes, its name, and what is refused."""
