"""Light transport at one vertex: the differentiable step, next-event estimation, lobes and attachment."""
