"""What a study says while it runs."""

from op3.identify.progress import TrialProgress


def test_without_a_terminal_lines_say_how_far_it_is(capsys, monkeypatch):
    """Now and then, and at the end, a line on standard error: trials, rate, time left, and the best value if any."""
    clock = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    with TrialProgress(40, 8) as shown:
        clock[0] += 4.0
        shown.update(16, 0.5)  # too soon
        clock[0] += 16.0
        shown.update(24, 0.25)
        shown.update(40, None)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["24/40 trials, 0.8 trials/s, 20 s left, best 0.25", "40/40 trials, 1.6 trials/s, 0 s left"]


def test_a_silent_study_says_nothing(capsys):
    """Whoever asks for silence gets it."""
    with TrialProgress(4, 0, enabled=False) as shown:
        shown.update(4, 1.0)
    assert capsys.readouterr().err == ""
