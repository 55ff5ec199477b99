"""Where a vehicle can drive: obstacles, edges, holes and free ground, with probabilities."""
