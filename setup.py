"""Only what pyproject.toml cannot say: found packages, settings, and a folder that installs under another name."""

from setuptools import find_packages, setup

setup(
    packages=[
        *find_packages(include=["graphslam*"]),
        "graphslam.app.presets",
        "graphslam.app.report.templates",
        "graphslam.cards",
    ],
    package_dir={"graphslam.cards": "datasets"},
)
