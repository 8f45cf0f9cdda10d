"""Samples of one epoch → what was heard: arrival, time scale, strength and their uncertainty, beacon by beacon."""
