"""Exceptions for Ctrl-C and ``kill``, so that clean-ups run. A lost one is raised again."""

import _thread
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Any

CLEAN_UP_S = 5.0  # time in which further signals are ignored
RESEND_DELAY_S = 0.05  # delay before a lost signal is sent again


class SignalError(BaseException):
    """Exception for a signal, which calls ``on_drop`` when it is garbage collected."""

    on_drop: Callable[[], None]

    def __del__(self) -> None:
        self.on_drop()


class _InterruptError(SignalError, KeyboardInterrupt):
    """Exception for Ctrl-C."""


class _KillError(SignalError, SystemExit):
    """Exception for ``kill`` or the end of the terminal, with the exit code of the command."""


class SignalHandler:
    """Handler of Ctrl-C and ``kill`` that raises one exception, so that clean-ups run once.

    Further signals during the clean-up are ignored. Some code drops the exception: Python does so
    in a finalizer and at the end of a fork, and C code and libraries do so mostly during imports.
    If the exception is garbage collected before ``has_ended`` is set, the signal is sent again.
    Forked processes inherit the handler, and ignore Ctrl-C.

    Attributes:
        received: Number of the signal whose exception was raised last; None before the first.
        has_ended: Whether the exception has arrived; from then on, no signal is sent again.
    """

    def __init__(self) -> None:
        self._main_process = os.getpid()
        self._raise_time_s = -math.inf  # time of the last exception, on the monotonic clock
        self.received: int | None = None
        self.has_ended = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise the exception of a signal.

        Args:
            number: Number of the signal.
            frame: Frame that the signal interrupts.
        """
        if os.getpid() != self._main_process:  # a forked worker
            if number == signal.SIGINT:
                return
            sys.exit(128 + number)
        now_s = time.monotonic()
        if now_s - self._raise_time_s < CLEAN_UP_S:
            return
        if _imports_extension(frame):
            self._send_again(number)
            return
        self._raise_time_s = now_s
        self.received = number
        # The exception is not stored in a variable. Its traceback refers to this frame, so a
        # variable of the frame would keep it alive.
        raise self._exception(number)

    def _exception(self, number: int) -> SignalError:
        """Return the exception for a signal."""
        error = _InterruptError() if number == signal.SIGINT else _KillError(128 + number)
        error.on_drop = partial(self._handle_drop, number)
        return error

    def _handle_drop(self, number: int) -> None:
        """Send a signal again whose exception was dropped."""
        if not self.has_ended and os.getpid() == self._main_process:
            self._raise_time_s = -math.inf
            self._send_again(number)

    def _send_again(self, number: int) -> None:
        """Send a signal after a delay.

        `threading` is not used, because its locks may be held when a signal arrives.
        """
        _thread.start_new_thread(_send_later, (number,))


def _send_later(number: int) -> None:
    """Wait, and send a signal to the main thread, which runs the handlers of signals."""
    time.sleep(RESEND_DELAY_S)
    signal.pthread_kill(threading.main_thread().ident or 0, number)


def _imports_extension(frame: FrameType | None) -> bool:
    """Whether an extension module is being imported; an exception there may end the process."""
    while frame is not None:
        # Python's loader of extension modules runs their code in these methods.
        if frame.f_code.co_name in ("create_module", "exec_module"):
            loader = frame.f_locals.get("self")
            if isinstance(loader, ExtensionFileLoader):
                return True
        frame = frame.f_back
    return False


def signal_behind(error: BaseException | None) -> SignalError | None:
    """Return the signal exception in the chain of an exception, or None."""
    while error is not None and not isinstance(error, SignalError):
        error = error.__cause__ or error.__context__
    return error


def hide_dropped_signals() -> None:
    """Hide what Python prints when it drops the exception of a signal, which is sent again."""
    # The hook is a `partial` of `_hide_signal`, whose function is its attribute `func`.
    if getattr(sys.unraisablehook, "func", None) is not _hide_signal:
        sys.unraisablehook = partial(_hide_signal, sys.unraisablehook)


def _hide_signal(default_hook: Callable[[Any], object], args: Any) -> None:
    """Report an exception that Python drops, unless it is that of a signal.

    Args:
        default_hook: Hook for all other exceptions that Python drops.
        args: Argument of the hook, with the exception in ``exc_value``.
    """
    if not isinstance(args.exc_value, SignalError):
        default_hook(args)
