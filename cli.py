"""The command line from a checkout: ``python cli.py generate pillar`` is ``scenegen generate
pillar``."""

from scenegen.__main__ import main

if __name__ == "__main__":
    main()
