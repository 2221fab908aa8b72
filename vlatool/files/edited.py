"""Old name of ``vlatool.files.user_files``, for packages that add a format of videos."""

from vlatool.files.user_files import stamp_of as stamp_of
