"""Storey 3: classical submap joiners (EIF in sequence and by binary tree, EKF) and landmark association."""
