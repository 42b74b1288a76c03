"""The differentiable step of a path at one vertex: arrival, next-event estimation and scattering."""
