"""Tests that need the CAD kernel (extra ``cad``) are collected only where it is installed."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("build123d") else ["test_samples.py", "test_usb_c.py"]
