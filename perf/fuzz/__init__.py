"""``python -m perf fuzz``: input as hostile as it comes, of every kind that users can hand over.

``driver`` runs trials in a watched child process; each kind of input is a module with one ``Kind`` (see ``trial``).
"""
