"""Media that Mitsuba lacks, and volumes from files."""
