"""Recordings: readers, one file for each format, selections of recordings, and random observations."""

from __future__ import annotations

from vlatool.data._calibration_checks import calibration_checks as calibration_checks
from vlatool.data._frame_files import picture_of as picture_of
from vlatool.data._frame_files import read_frame as read_frame
from vlatool.data._frame_files import write_beside as write_beside
from vlatool.data._halves import halves as halves
from vlatool.data._not_finite import takes_not_finite as takes_not_finite
from vlatool.data._not_finite import with_not_finite as with_not_finite
from vlatool.data._observations import Observations as Observations
from vlatool.data._observations import observations_for as observations_for
from vlatool.data._observations import random_observations as random_observations
from vlatool.data._observations import recorded_observations as recorded_observations
from vlatool.data._observations import synthetic_observations as synthetic_observations
from vlatool.data._random_observations import RANDOM_KIND as RANDOM_KIND
from vlatool.data._random_observations import RECORDED_KIND as RECORDED_KIND
from vlatool.data._random_observations import REWORDED_KIND as REWORDED_KIND
from vlatool.data._random_observations import Drawer as Drawer
from vlatool.data._random_observations import Drawn as Drawn
from vlatool.data._random_observations import read_drawn as read_drawn
from vlatool.data._random_observations import save_drawn as save_drawn
from vlatool.data._reader import Reader as Reader
from vlatool.data._reader import read_recording as read_recording
from vlatool.data._recording import Moment as Moment
from vlatool.data._recording import Recording as Recording
from vlatool.data._recording import build_recording as build_recording
from vlatool.data._selections import PURPOSES as PURPOSES
from vlatool.data._selections import calibration_recording as calibration_recording
from vlatool.data._selections import carries_evaluation as carries_evaluation
from vlatool.data._selections import carry_recording as carry_recording
from vlatool.data._selections import evaluation_recording as evaluation_recording
from vlatool.data._selections import is_of_recording as is_of_recording
from vlatool.data._selections import recordings_of as recordings_of
from vlatool.data._training_observations import BEGINS as BEGINS
from vlatool.data._training_observations import MAX_PLAYED as MAX_PLAYED
from vlatool.data._training_observations import OBSERVATIONS_FILE as OBSERVATIONS_FILE
from vlatool.data._training_observations import Encoded as Encoded
from vlatool.data._training_observations import kept_rows as kept_rows
from vlatool.data._training_observations import played_observations as played_observations
