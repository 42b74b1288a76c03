"""The objective: loss and gradients as a function of the values, evaluated for some of the views at a time."""
