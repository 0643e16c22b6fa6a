"""The live view: Foxglove's websocket in a process of its own, the topics of a record and a scene."""
