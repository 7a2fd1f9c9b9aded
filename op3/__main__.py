"""``python -m op3``, see `op3.command_line`."""

from op3.command_line import main

main()
