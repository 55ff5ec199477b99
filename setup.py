"""Only what pyproject.toml cannot say: found packages, and a folder that installs under another name."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["graphslam*"]), "graphslam.cards"],
    package_dir={"graphslam.cards": "datasets"},
)
