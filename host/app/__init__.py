"""The commands: the command line, pictures, the selftest."""
