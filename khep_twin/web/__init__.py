"""The designer: a page in the browser for drawing playpens and watching robots.

The page is plain HTML, SVG and JavaScript in `assets/web`, served by Starlette and uvicorn. A widget library
such as NiceGUI was tried and not used: it takes 105 MB and 2 s to import where these take 5 MB and 0.4 s. An
editor for drawings needs JavaScript anyway, and here each request passes one guard that is small enough to
be read. The page loads nothing from outside, so it works without a network.

    guard       checks of each request: host, origin, token, sizes
    documents   playpen files below one folder, and drafts of unsaved changes
    drafts      playpens as the page sends them, with their problems
    scene       compiled scenes for the 3-D view, and turrets from above; robot_shape: outlines of robots
    session     common part of the actors: robot_session (a robot at a port) and twin_session
    paced_twin  a twin that can be watched, paused, and shared with an outside host
    jobs        jobs of the robot: controllers and sensor tests
    print_capture   output of controllers
    challenges  programs scored in challenges
    messages    kinds of messages to the pages; broadcaster sends them
    requests    kinds of requests; answers turns them into actions and replies
    file_actions, session_actions   actions by subject
    routes      the page's files, actions and messages
    server      socket, token, guard and page
"""
