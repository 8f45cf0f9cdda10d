"""Robots that place each other: several robots' places and peer ranges → joint estimates, roles."""
