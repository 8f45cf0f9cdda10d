"""Bursts that are learnt: what a beacon really sends, from recordings at a known distance."""
