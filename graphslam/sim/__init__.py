"""Storey 4: simulated worlds, vehicles and sensors with stated noise, truth included."""
