"""Skeleton networks: measurement nodes collapsed into landmarks, landmarks integrated out, poses relaxed."""
