"""The command `gough`, as `python -m hil.command_line`."""

import sys

from hil.command_line import main

if __name__ == "__main__":
    sys.exit(main())
