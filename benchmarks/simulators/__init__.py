"""Blind cases of simulators that are not made of effects."""
