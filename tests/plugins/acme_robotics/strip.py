"""A format of videos: all pictures below each other, in one file of numpy."""

import numpy as np

from vlatool.files.user_files import stamp_of


class Strip:
    """Writes NAME.strip."""

    def check(self):
        """Refuse to begin where a package is missing; numpy never is."""

    def write(self, video, draft):
        """Write the pictures, uint8 (N, H, W, 3); return what was left out, in a few words."""
        with draft.open("wb") as file:
            np.save(file, np.stack(list(video.pictures())))
            file.write(b"\n")
        with draft.open("ab") as file:
            file.write(stamp_of(draft.read_bytes()))
        return ""
