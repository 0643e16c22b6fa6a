"""Byte pipes: serial, UDP, in memory."""
