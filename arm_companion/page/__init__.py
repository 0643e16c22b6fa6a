"""The page for the field: a small HTTP server in a process of its own, and the files that it serves."""
