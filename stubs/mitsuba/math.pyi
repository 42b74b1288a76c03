RayEpsilon: float
