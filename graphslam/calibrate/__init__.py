"""Noise and lasting errors of a robot's sensors, estimated from a log itself, without truth."""
