"""The designer and panel: a page of this machine's browser, where a playpen is built and a robot is watched.

The page is plain HTML, SVG and JavaScript in `assets/web`, served by Starlette and uvicorn. A kit of widgets
such as NiceGUI was tried and left: it takes 105 MB and 2 s to import where these take 5 MB and 0.4 s, an
editor for drawings needs JavaScript of its own anyway, and here each request passes one guard that is
small enough to be read. Nothing is fetched from outside, so that the page works without a network.

    guard       checks of each request: host, origin, token, sizes
    documents   playpen files below one folder, and drafts of what is not saved yet
    drafts      playpens as the page sends them, with their problems
    paced_twin  a twin that can be watched, paused, and shared with an outside host
    stage       the running twin, or the robot, of the page, in a thread of its own
    jobs        jobs of the robot: controllers and sensor tests
    routes      actions and files that the page requests
    server      all of it together
"""
