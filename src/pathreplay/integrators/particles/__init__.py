"""Light paths from the emitters: the gradient term, and the integrator plugin that traces all light this way."""
