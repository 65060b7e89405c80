"""When this package began to be imported: what the command line counts from. The age of the process would not do,
since a shell may have turned into it."""

import time

BEGAN = time.perf_counter()
CPU_BEFORE = time.process_time()  # the interpreter's own start
