"""Code in processes of its own, which are forks of one that has imported what takes seconds, and nothing of us."""

import multiprocessing
import runpy
from pathlib import Path

FORKS = multiprocessing.get_context("forkserver")
PACKAGES = ["torch", "torchrl.data", "gymnasium", "mujoco", "casadi", "matplotlib.pyplot", "IPython"]
FORKS.set_forkserver_preload(PACKAGES)


def run_code(code: list[str], folder: Path) -> str:
    """Run blocks in a process and a folder of their own: they may register what they want, and read nothing of ours.

    Returns:
        What they have written to stderr.
    """
    script, said = folder / "page.py", folder / "said"
    head = f"import os\nos.chdir({str(folder)!r})\nos.dup2(os.open({str(said)!r}, os.O_CREAT | os.O_WRONLY), 2)\n"
    script.write_text(head + "import torch\n\ntorch.set_num_threads(1)\n" + "\n".join(code))
    process = FORKS.Process(target=runpy.run_path, args=(str(script),), kwargs={"run_name": "__main__"})
    process.start()
    process.join(600)
    assert process.exitcode == 0, said.read_text()[-3000:]
    return said.read_text()
