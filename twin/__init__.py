"""Robots, the pick-and-place controller, scoring and the command line: the only package that sees all others."""
