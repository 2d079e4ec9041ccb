"""``python -m s4a`` is the command ``s4a``."""

from s4a.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
