"""Loops between submaps and ties between sessions: candidates, gates, consistency, ledger."""
