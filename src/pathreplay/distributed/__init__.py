"""Evaluates shards (parts of an iteration) in Ray actors, on this machine or on a cluster."""
