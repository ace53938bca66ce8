"""Progress: a bar where it can be drawn, lines elsewhere, and time left that does not count what was done before."""



from freegeo import progress


def test_progress_without_a_terminal_is_a_line_per_tenth(capsys):
    with progress.progress_bar("steps", 40) as update:
        update(0, "getting ready")
        for k in range(40):
            update(k + 1, f"loss {k}")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 11
    assert lines[0] == "steps: 0/40, getting ready", "nothing is known of the time that is left"
    assert lines[-1].startswith("steps: 40/40, 0 s left")


def test_progress_of_a_resumed_run_does_not_take_the_earlier_part_for_speed(capsys, monkeypatch):
    clock = iter([0.0, 0.0, 10.0, 10.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with progress.progress_bar("steps", 100) as update:
        update(60)
        update(70)
    assert capsys.readouterr().err.splitlines() == ["steps: 60/100", "steps: 70/100, 30 s left"]
