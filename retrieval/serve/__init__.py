"""The HTTP service: queries over HTTP, and a web page.

    app             creates the application from its parts; other packages need only `create_app`
    settings        options of the operator
    security        access control (local requests, or a token), and headers of every response
    uploads         request bodies: limits, JSON, forms
    decoders        image decoding in separate processes (decode_process)
    queue           admission, deadlines and batches of requests
    generations     the generation of the index that answers
    queries, catalogue, history, human_baseline, live, health    the routes
    store, history_writer    SQLite database: queries, feedback, trials; recording of the feedback
    client          `Searcher.query` for an index on another machine

The layer follows `report` and does not import `robot`: the command passes callables.
"""
