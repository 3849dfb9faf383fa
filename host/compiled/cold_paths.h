/* Included before the generated C: what runs only when something is raised is cold, so that the compiler moves every
   path that leads there out of the way of the tick.  A tick after 5 ms of other work costs what it touches. */
#include <Python.h>
#include <CPy.h>
#define COLD __attribute__((cold))
extern COLD void CPyError_OutOfMemory(void);
extern COLD void CPy_TypeError(const char *expected, PyObject *value);
extern COLD void CPy_AddTraceback(const char *filename, const char *funcname, int line, PyObject *globals);
extern COLD void CPy_TypeErrorTraceback(const char *filename, const char *funcname, int line, PyObject *globals,
                                        const char *expected, PyObject *value);
extern COLD void CPy_AttributeError(const char *filename, const char *funcname, const char *classname,
                                    const char *attrname, int line, PyObject *globals);
static COLD void CPy_DecRef(PyObject *p);
static COLD void CPy_XDecRef(void *p);
extern COLD void CPyTagged_IncRef(CPyTagged x);
extern COLD void CPyTagged_DecRef(CPyTagged x);
extern COLD void PyErr_SetString(PyObject *exception, const char *string);
extern COLD PyObject *PyErr_Occurred(void);
