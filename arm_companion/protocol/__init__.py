"""Bytes <-> messages, without input or output."""
