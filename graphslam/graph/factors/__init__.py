"""Kinds of factors."""
