"""Positioning by sound: from microphone samples to a fused track."""
