"""Rendering for other frameworks: functions of their arrays, which their own differentiation goes through."""
