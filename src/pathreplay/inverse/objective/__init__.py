"""The objective: loss and gradients as a function of values and of a shard of the views."""
