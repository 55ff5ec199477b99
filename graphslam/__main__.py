"""``python -m graphslam``: the command line where the command ``graphslam`` is not on the path."""

from graphslam.app.cli import main

main()
