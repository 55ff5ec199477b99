"""Surfaces of the solved map: a signed distance that follows the graph, and its zero set as a mesh."""
