"""MAVLink companion-computer service for a tendon-driven continuum arm on a drone."""

__version__ = "0.1.0"
