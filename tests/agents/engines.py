"""Engines that note or interrupt what they run."""


class Noting:
    """Runs tasks in this process, and notes them."""

    is_parallel = False

    def __init__(self, interrupt_after=None):
        self.tasks, self.interrupt_after = [], interrupt_after

    @property
    def n_episodes(self):
        return sum(len(task.seeds) for task in self.tasks)

    def run(self, work, tasks):
        for task in tasks:
            if len(self.tasks) == self.interrupt_after:
                raise KeyboardInterrupt
            self.tasks.append(task)
            yield task, work(task)


def cut(path):
    """Cut a ledger as a kill in the middle of a write does: some of the last two lines are gone."""
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b"\n", 0, len(content) - 200) - 9])
    return content
