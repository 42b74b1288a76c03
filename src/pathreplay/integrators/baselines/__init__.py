"""Other differentiation methods for path tracers, for comparison only. No other part of the package depends on them."""
