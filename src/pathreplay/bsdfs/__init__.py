"""BSDF plugins that Mitsuba lacks."""
