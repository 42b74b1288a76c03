"""Samplers: counter-based and Owen-scrambled Sobol samplers, sample sets per pixel, and named random streams."""
