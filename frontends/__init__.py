"""Storey 2, beside the graph: sensor data in, submaps out. Never imports gtsam."""
