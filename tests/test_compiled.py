"""What a user reads while code is compiled."""

from sim.compiled import _Announcer


def test_processes_that_work_together_say_it_once(tmp_path, capsys):
    for _ in range(2):
        one = _Announcer()
        one.once_in = tmp_path / "compiling"
        one.on_start(None)
        one.on_start(None)
    assert capsys.readouterr().err.count("compiling") == 1


def test_each_process_alone_says_it_once(capsys):
    for _ in range(2):
        one = _Announcer()
        one.on_start(None)
        one.on_start(None)
    assert capsys.readouterr().err.count("compiling") == 2


def test_a_folder_that_is_gone_is_no_error(tmp_path, capsys):
    one = _Announcer()
    one.once_in = tmp_path / "gone" / "compiling"
    one.on_start(None)
    assert not capsys.readouterr().err
