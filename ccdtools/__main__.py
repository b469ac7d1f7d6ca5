"""``python -m ccdtools``."""

from ccdtools.cli import main

if __name__ == "__main__":
    main()
