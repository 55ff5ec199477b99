"""Surface reconstruction: a signed distance field that follows the graph, and its zero level set as a mesh."""
