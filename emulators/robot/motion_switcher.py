"""Implement Unitree's MotionSwitcher service, which its low-level examples call before they move.

On a robot the service starts and stops the walking programs. The emulated robot has none: it stores
the name that a client selected, and returns it until the client releases it. No DDS:
:mod:`dexkit.emulators.robot.run` connects it to the topics.
"""

from __future__ import annotations

import json
from typing import Any

from dexkit.messages.unitree_api import Request_, Response_, ResponseHeader_, ResponseStatus_

__all__ = ["REQUEST_TOPIC", "REQUEST_TYPE", "RESPONSE_TOPIC", "RESPONSE_TYPE", "MotionSwitcher"]

REQUEST_TOPIC = "rt/api/motion_switcher/request"
RESPONSE_TOPIC = "rt/api/motion_switcher/response"
REQUEST_TYPE = "unitree_api::msg::dds_::Request_"
RESPONSE_TYPE = "unitree_api::msg::dds_::Response_"

# unitree_sdk2 include/unitree/robot/b2/motion_switcher/motion_switcher_api.hpp; 1 is every
# service's (unitree_sdk2_python rpc/internal.py)
_VERSION, _CHECK, _SELECT, _RELEASE, _SET_SILENT, _GET_SILENT = 1, 1001, 1002, 1003, 1004, 1005
_API_VERSION = "1.0.0.1"
# motion_switcher_error.hpp beside it, and internal/internal_error.hpp
_OK, _NOT_IMPLEMENTED, _BAD_PARAMETER, _BAD_NAME = 0, 3203, 7001, 7004
# names of forms 0 and 1: unitree_sdk2 example/go2/go2_stand_example.cpp, queryServiceName
_FORMS = {"normal": "0", "ai": "0", "advanced": "0", "ai-w": "1", "normal-w": "1"}


class MotionSwitcher:
    """The service.

    :ivar name: of the motion program selected, or empty.
    :ivar requests: answered.
    """

    def __init__(self) -> None:
        self.name = ""
        self.requests = 0
        self._silent = False

    def answer(self, request: Request_) -> Response_ | None:
        """Execute a request; return the response, or None if the client wants none."""
        self.requests += 1
        identity = request.header.identity
        code, data = self._serve(identity.api_id, request.parameter)
        if request.header.policy.noreply:
            return None
        return Response_(ResponseHeader_(identity, ResponseStatus_(code)), data)

    def _serve(self, api: int, parameter: str) -> tuple[int, str]:
        """(code, data) of one request."""
        if api == _VERSION:
            return _OK, _API_VERSION
        if api == _CHECK:
            return _OK, json.dumps({"form": _FORMS.get(self.name, "0"), "name": self.name})
        if api == _RELEASE:
            self.name = ""
            return _OK, ""
        if api == _GET_SILENT:
            return _OK, json.dumps({"silent": self._silent})
        if api not in (_SELECT, _SET_SILENT):
            return _NOT_IMPLEMENTED, ""
        try:
            asked: Any = json.loads(parameter)
        except (ValueError, RecursionError):
            return _BAD_PARAMETER, ""
        member = "name" if api == _SELECT else "silent"
        value = asked.get(member) if isinstance(asked, dict) else None
        if api == _SELECT:
            if not isinstance(value, str):
                return _BAD_PARAMETER, ""
            if value not in _FORMS:
                return _BAD_NAME, ""
            self.name = value
        elif isinstance(value, bool):
            self._silent = value
        else:
            return _BAD_PARAMETER, ""
        return _OK, ""
