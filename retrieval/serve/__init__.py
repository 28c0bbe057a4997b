"""The service: the same answers over HTTP, and a page to look at them.

    app          puts the parts together; `create_app` is all that others need
    settings     what an operator may choose
    security     who may ask: this machine, or who knows the token; headers of every response
    uploads      bodies of requests: how large, how long, what pictures; forms takes multipart bodies apart
    decoders     pictures of requests, decoded in processes of their own (decode_process)
    queue        who waits, for how long, and who is answered together
    generations  which generation of the index answers
    queries, catalogue, history, trials, rig, health    the paths
    store        what is kept: queries, what people said of them, trials
    client       the same `query` on another machine

The layer stands after `report` and knows nothing of rigs: the command hands it callables.
"""
