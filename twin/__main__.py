"""``python -m twin`` is ``tagcell``."""

from twin.cli import main

if __name__ == "__main__":
    main()
