"""Drive a daemon from a program; `ident ... --server URL` uses this client, too.

```
from ident_service.client import IdentClient

with IdentClient("https://robot.example:8470", token) as client:
    ended = client.compute("design", arm="wam7", seconds=30.0)
    with client.arm("wam7").run(ended.run, confirm="wam7") as job:  # the lease is renewed until the block is left
        for sample in job.live():
            print(sample.time, sample.following_error)
    print(job.ended.run)  # of a motion that came to its end
```

An exception in the block of a motion brings the arm to a controlled stop. The end of the block waits for the motion's,
and raises what kept it from its end: a fault, a refusal, somebody's stop.
Errors are those of `ident_service.errors`: the daemon's own, and `ArmError` where it cannot be reached. A certificate
is checked as the system does (`SSL_CERT_FILE` names another authority); proxies of the environment are not asked.
"""

from ident_service.client.client import Event as Event
from ident_service.client.client import IdentClient as IdentClient
from ident_service.client.client import Job as Job
from ident_service.client.client import LiveSample as LiveSample
from ident_service.client.client import RemoteArm as RemoteArm
from ident_service.client.client import RemoteMotion as RemoteMotion
from ident_service.client.client import left_alone as left_alone
