"""``python -m graphslam.app.cli``."""

from graphslam.app.cli import main

main()
