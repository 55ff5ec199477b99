"""Faults that are put into clean logs: what broken sensors, drivers and recorders write."""
