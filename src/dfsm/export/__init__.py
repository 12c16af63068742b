"""What was found, in the files of other programs."""

from dfsm.export.rosco import RoscoInput, write_rosco

__all__ = ["RoscoInput", "write_rosco"]
