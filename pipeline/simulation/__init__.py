"""Made places: a seeded generator or an overhead image comes in, pictures of one place from above
go out.
"""
