"""Reading and writing: site files, recordings, runs; every mistake is told in one line, all at once."""

from sonofix.files.problem import Problem, RecordingError
from sonofix.files.recording import read_recording, read_references, read_truth
from sonofix.files.recording_writer import write_recording
from sonofix.files.site_file import read_site, site_text
from sonofix.files.writing import RunWriter, write_run, write_track

__all__ = [
    "Problem",
    "RecordingError",
    "RunWriter",
    "read_recording",
    "read_references",
    "read_site",
    "read_truth",
    "site_text",
    "write_recording",
    "write_run",
    "write_track",
]
