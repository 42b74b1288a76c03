"""Random numbers: counter-based, Owen-scrambled Sobol points, and those of pixels."""
