# SPDX-License-Identifier: Apache-2.0


def test_the_speed_of_nltgv_is_told_with_the_energy(tool, capsys):
    assert tool("benchmark_nltgv").main(["--vertices", "400", "--iterations", "300"]) == 0
    words = capsys.readouterr().out.split()
    assert words[0] == "400" and 1100 < int(words[2]) < 1200
    assert float(words[4]) > 100 and float(words[-1]) < float(words[-3])
