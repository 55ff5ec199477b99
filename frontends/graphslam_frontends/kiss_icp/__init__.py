"""The front end ``kiss-icp``."""
