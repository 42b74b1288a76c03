"""Participating media along rays: free flight, transmittance, null boundaries."""
