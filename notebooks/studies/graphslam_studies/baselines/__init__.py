"""Methods to compare with: all poses and landmarks at once, links between poses."""
