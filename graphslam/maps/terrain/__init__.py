"""Traversability maps for a vehicle: obstacles, edges, holes and free ground, with probabilities."""
