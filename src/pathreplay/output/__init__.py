"""What leaves the program: pictures of scenes, and what a run has recovered as files that other programs read."""
