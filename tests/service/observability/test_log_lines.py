import io
import threading

import structlog

from service.observability.log_lines import MAX_WAITING, LogLines
from tests.service.client import Driver
from tests.service.conftest import LiveService


class Stuck(io.StringIO):
    """A pipe whose reader has stopped until ``reads`` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.reads, self.asked = threading.Event(), threading.Event()

    def write(self, text: str) -> int:
        self.asked.set()
        self.reads.wait(30)
        return super().write(text)


def test_lines_come_out_in_order() -> None:
    out = io.StringIO()
    lines = LogLines(lambda: out)
    for number in range(100):
        lines.write(f"{number}\n")
    lines.close()
    assert out.getvalue().split() == [str(number) for number in range(100)]
    assert lines.lost_n == 0


def test_a_pipe_that_nobody_reads_delays_nobody_and_the_log_says_what_it_lost() -> None:
    out = Stuck()
    lines = LogLines(lambda: out)
    lines.write("first\n")
    assert out.asked.wait(30)
    for _ in range(MAX_WAITING + 7):
        lines.write("x\n")
    assert lines.lost_n == 7
    out.reads.set()
    lines.close(30)
    assert "7 log lines were lost" in out.getvalue()
    assert out.getvalue().count("x\n") == MAX_WAITING


def test_a_closed_standard_error_ends_no_insertion(live: LiveService) -> None:
    closed = io.StringIO()
    closed.close()
    lines = LogLines(lambda: closed)
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(lines))
    try:
        driver = Driver(live, "unlogged")
        assert driver.until("hello").insertion_id == "unlogged"
        finished = driver.insert(1)
        assert finished.outcome == "inserted", finished.doubts
        driver.close()
    finally:
        structlog.reset_defaults()
        lines.close()
    assert lines.lost_n >= 1
