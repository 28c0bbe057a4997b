"""The HTTP service: queries over HTTP, and a web page; other packages need only `app.create_app` and `client`.

A request passes `security` (hosts and tokens), `uploads` (limits of its body), a route (`queries`, `catalogue`,
`history`), `queue` (capacity and deadlines), `decoders` (pictures, in threads) and `generations`
(the open index); `store` keeps it. The layer does not import `robot`: the command passes callables.
"""
