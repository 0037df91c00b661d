"""Wrong solutions that are written anew with a wrong idea; frozen before the library of mistakes.

None is an edit of the kit's solution. Each stands as: idea, kind, body. The kind says which general
finding would be right: "sign" or "factor"; "form" for none.
"""
