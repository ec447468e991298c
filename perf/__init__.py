"""Measured figures of leafflow-ti, each made by one command: ``python -m perf NAME``; without a name it lists them."""
