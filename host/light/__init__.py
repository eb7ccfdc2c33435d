"""How light reaches the ground: light methods (protocol: base.py), and the launches and tables they use."""
