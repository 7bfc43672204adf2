"""An executor for tests of what tasks need."""

import pickle

from agents.executors import ThisProcess


class Elsewhere(ThisProcess):
    """Runs tasks as another process would: on copies, by what is pickled of them."""

    def submit(self, fn, /, *args, **kwargs):
        call, copies = pickle.loads(pickle.dumps((fn, args)))
        return super().submit(lambda: pickle.loads(pickle.dumps(call(*copies))))
