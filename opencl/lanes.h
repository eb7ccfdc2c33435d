/* LANES adjacent lines or pixels per work-item: 1 on a GPU; 8 on a CPU, in some stems 16, which fill one
   vector register. */
#pragma OPENCL FP_CONTRACT OFF
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if LANES == 1
typedef float floats;
typedef int ints;
typedef uint uints;
typedef uchar uchars;
#define LOAD(offset, pointer) (pointer)[offset]
#define STORE(value, offset, pointer) (pointer)[offset] = (value)
#define TO_INTS convert_int
#define TO_UCHARS convert_uchar
#define WHERE(test) (-(int)(test)) /* all bits set, as a vector comparison gives */
#define as_uints as_uint
#else
typedef JOIN(float, LANES) floats;
typedef JOIN(int, LANES) ints;
typedef JOIN(uint, LANES) uints;
typedef JOIN(uchar, LANES) uchars;
#define LOAD(offset, pointer) JOIN(vload, LANES)(0, (pointer) + (offset))
#define STORE(value, offset, pointer) JOIN(vstore, LANES)(value, 0, (pointer) + (offset))
#define TO_INTS JOIN(convert_int, LANES)
#define TO_UCHARS JOIN(convert_uchar, LANES)
#define WHERE(test) (test)
#define as_uints JOIN(as_uint, LANES)
#endif
/* Fetches what a CPU does not foresee: rows of a large map lie farther apart than the pages within which it
   looks ahead. Addresses may lie outside a buffer. */
#if ON_CPU && defined(__clang__)
#define PREFETCH(pointer) __builtin_prefetch((const void *)(size_t)(pointer))
#endif
/* READ as LOAD. PoCL calls its vload, but these are inline; a GPU would read a packed struct by bytes. */
typedef struct __attribute__((packed)) { floats v; } loose_floats;
typedef struct __attribute__((packed)) { ints v; } loose_ints;
#if LANES == 1 || !ON_CPU
#define READ LOAD
#define READ_INTS LOAD
#else
#define READ(offset, pointer) (((__global const loose_floats *)((pointer) + (offset)))->v)
#define READ_INTS(offset, pointer) (((__global const loose_ints *)((pointer) + (offset)))->v)
#endif
