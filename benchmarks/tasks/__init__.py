"""What is measured: each task lists its jobs and makes a table of what they found."""
