"""Planning: which light method an image begins with, and how much of it, for each kind of source."""
