"""Servers of a policy: other programs send observations and get chunks of actions; one file for each protocol."""

from __future__ import annotations

from vlatool.serving._access import Access as Access
from vlatool.serving._chunk_envelope import ChunkEnvelope as ChunkEnvelope
from vlatool.serving._endpoint import Endpoint as Endpoint
from vlatool.serving._observation_names import ObservationNames as ObservationNames
from vlatool.serving._request_log import RequestLog as RequestLog
from vlatool.serving._service import Answer as Answer
from vlatool.serving._service import RequestRecord as RequestRecord
from vlatool.serving._service import Service as Service
from vlatool.serving._service import Session as Session
