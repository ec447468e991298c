"""Runs that are killed, or lose power or disk at any moment, must end with the bytes of an undisturbed one."""
