"""A file that HDF5 can be given on a disk that may fill up."""

import io
from typing import Any


class PatientFile(io.FileIO):
    """Keeps its first error for later, when HDF5 is done with it: look at `error` before believing what was written.

    HDF5 that cannot write its last bytes says so where Python cannot hear it, leaves a file that looks whole, and ends
    the program by a segmentation fault at its exit.
    """

    error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write all of it, or from the first error on nothing."""
        left = memoryview(content)
        try:
            while self.error is None and len(left) > 0:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """Change the size, if that can be done."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return self.tell() if size is None else size
