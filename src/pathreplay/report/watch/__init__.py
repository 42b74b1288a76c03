"""Looking at runs: a local page that follows one, runs side by side, films, and their numbers for other tools."""
