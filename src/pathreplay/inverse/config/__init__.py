"""The schema of a job: tables of keys, read from TOML, JSON or YAML and checked before anything is rendered."""
