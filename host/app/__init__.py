"""What people run: the command line, pictures, the selftest."""
