"""Maps that follow the graph: pieces of submaps, fused at the solved poses and re-posed when nodes move."""
