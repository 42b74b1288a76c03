"""How it is measured: what a job says, the process that runs it, passes of every kind, and what their samples tell."""
