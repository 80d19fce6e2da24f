"""The command line from a checkout: ``python cli.py verify data/pillar`` is ``scenegen verify
data/pillar``. `scenegen.__main__` lists the commands."""

from scenegen.__main__ import main

if __name__ == "__main__":
    main()
