"""How light reaches the ground: a file a method, all with the protocol of base.py."""
