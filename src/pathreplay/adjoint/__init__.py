"""Drivers: functions that trace paths to render them, or to differentiate them in forward or reverse mode."""
