"""The HTTP service: queries over HTTP, and a web page.

    app             creates the application from its parts; other packages need only `create_app`
    settings        options of the operator
    security        access control (local requests, or a token), headers of every response, health
    uploads         request bodies: limits, JSON, forms
    decoders        image decoding in separate processes
    queue           admission, deadlines and batches of requests
    generations     the generation of the index that answers
    queries, catalogue, history, human_baseline    the routes
    store           SQLite database: queries, feedback, trials; recording of the feedback
    client          `Searcher.query` for an index on another machine

The layer follows `report` and does not import `robot`: the command passes callables.
"""
