"""Measured figures of leafflow-ti, each made by one command: ``python -m perf NAME`` (``python -m perf`` lists them)."""
