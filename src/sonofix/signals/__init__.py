"""What a beacon sends: codes, their waveform after both transducers, and samples of it at any instant."""
