"""The loop: steps, events, checkpoints, and whether values still move."""
