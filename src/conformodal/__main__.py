"""``python -m conformodal`` is the command ``conformodal``."""

from .cli import main

if __name__ == "__main__":
    main()
