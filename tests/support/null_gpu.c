/* A CUDA driver and an OptiX that run nothing, for tests of what Dr.Jit traces and records on machines without a GPU.
   Device memory is the host's, copies are made, kernels are compiled to nothing and never run: all results are zero. */

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
#define NOTHING(name) EXPORT int name(void) { return 0; }
#define FAILS(name) EXPORT int name(void) { return 1; }
#define CREATES(name) EXPORT int name(void **object) { *object = allocated(8); return object && *object ? 0 : 2; }
#define HANDLE ((void *) 1)

static void *allocated(size_t size) {
    void *memory = NULL;
    if (posix_memalign(&memory, 256, size + 256)) return NULL;
    return memset(memory, 0, size);
}

static int allocate(void **memory, size_t size) { return (*memory = allocated(size)) ? 0 : 2; }

/* ------------------------------------------------ CUDA driver ------------------------------------------------ */

NOTHING(cuInit) NOTHING(cuCtxEnablePeerAccess) NOTHING(cuCtxSynchronize) NOTHING(cuDevicePrimaryCtxRelease_v2)
NOTHING(cuEventRecord) NOTHING(cuEventSynchronize) NOTHING(cuEventQuery) NOTHING(cuFuncSetAttribute)
NOTHING(cuLaunchKernel) NOTHING(cuMemAdvise) NOTHING(cuModuleUnload) NOTHING(cuCtxPushCurrent_v2)
NOTHING(cuStreamSynchronize) NOTHING(cuStreamWaitEvent) NOTHING(cuStreamWaitEvent_ptsz) NOTHING(cuMemcpy2DAsync_v2)
NOTHING(cuMemcpy3DAsync_v2) NOTHING(cuProfilerStart) NOTHING(cuProfilerStop)
FAILS(cuGraphicsGLRegisterBuffer) FAILS(cuGraphicsGLRegisterImage) FAILS(cuGraphicsUnregisterResource)
FAILS(cuGraphicsMapResources) FAILS(cuGraphicsUnmapResources) FAILS(cuGraphicsSubResourceGetMappedArray)
FAILS(cuGraphicsResourceGetMappedPointer)
CREATES(cuEventCreate) CREATES(cuStreamCreate) CREATES(cuSurfObjectCreate)

EXPORT int cuDeviceGet(int *device, int index) { return *device = index, 0; }
EXPORT int cuDeviceGetCount(int *count) { return *count = 1, 0; }
EXPORT int cuDeviceCanAccessPeer(int *can) { return *can = 0, 0; }
EXPORT int cuDeviceGetName(char *name, int size) { return snprintf(name, (size_t) size, "no GPU"), 0; }
EXPORT int cuDeviceTotalMem_v2(size_t *bytes) { return *bytes = (size_t) 80 << 30, 0; }
EXPORT int cuDriverGetVersion(int *version) { return *version = 13000, 0; }
EXPORT int cuDevicePrimaryCtxRetain(void **context) { return *context = HANDLE, 0; }
EXPORT int cuCtxPopCurrent_v2(void **context) { return context ? (*context = HANDLE, 0) : 0; }
EXPORT int cuEventElapsedTime(float *ms) { return *ms = 1, 0; }
EXPORT int cuGetErrorName(int error, const char **text) { return *text = "error of the GPU that is none", 0; }
EXPORT int cuGetErrorString(int error, const char **text) { return cuGetErrorName(error, text); }

/* Attributes of an H100. */
EXPORT int cuDeviceGetAttribute(int *value, int attribute, int device) {
    switch (attribute) {
        case 75: return *value = 9, 0;       /* compute capability 9.0 */
        case 16: return *value = 132, 0;     /* multiprocessors */
        case 39: return *value = 2048, 0;    /* threads of each */
        case 97: return *value = 232448, 0;  /* bytes of shared memory */
        case 41: case 90: case 115: return *value = 1, 0; /* unified addresses, preemption, memory pools */
        default: return *value = 0, 0;
    }
}

EXPORT int cuMemAlloc_v2(void **memory, size_t size) { return allocate(memory, size); }
EXPORT int cuMemAllocHost_v2(void **memory, size_t size) { return allocate(memory, size); }
EXPORT int cuMemAllocAsync(void **memory, size_t size, void *stream) { return allocate(memory, size); }
EXPORT int cuMemFree_v2(void *memory) { return free(memory), 0; }
EXPORT int cuMemFreeHost(void *memory) { return free(memory), 0; }
EXPORT int cuMemFreeAsync(void *memory, void *stream) { return free(memory), 0; }
EXPORT int cuEventDestroy_v2(void *event) { return free(event), 0; }
EXPORT int cuStreamDestroy_v2(void *stream) { return free(stream), 0; }
EXPORT int cuSurfObjectDestroy(void *surface) { return free(surface), 0; }
EXPORT int cuPointerGetAttribute(void *value, int attribute, void *pointer) { return *(unsigned *) value = 2, 0; }
EXPORT int cuMemcpy(void *to, const void *from, size_t size) { return memmove(to, from, size), 0; }
EXPORT int cuMemcpyAsync(void *to, const void *from, size_t size, void *stream) { return memmove(to, from, size), 0; }
EXPORT int cuMemsetD8Async(void *to, unsigned char value, size_t count, void *stream) {
    return memset(to, value, count), 0;
}
EXPORT int cuMemsetD16Async(void *to, unsigned short value, size_t count, void *stream) {
    for (size_t i = 0; i < count; i++) ((unsigned short *) to)[i] = value;
    return 0;
}
EXPORT int cuMemsetD32Async(void *to, unsigned value, size_t count, void *stream) {
    for (size_t i = 0; i < count; i++) ((unsigned *) to)[i] = value;
    return 0;
}
EXPORT int cuLaunchHostFunc(void *stream, void (*function)(void *), void *data) { return function(data), 0; }

EXPORT int cuModuleLoadData(void **module) { return *module = HANDLE, 0; }
EXPORT int cuModuleLoadDataEx(void **module) { return *module = HANDLE, 0; }
EXPORT int cuModuleGetFunction(void **function) { return *function = HANDLE, 0; }
EXPORT int cuOccupancyMaxPotentialBlockSize(int *blocks, int *threads) { return *blocks = 132, *threads = 256, 0; }

/* Textures: an array remembers its size, a texture its array. */
typedef struct { size_t width, height, depth; int format; unsigned channels, flags; } Shape;
typedef struct { size_t width, height; int format; unsigned channels; } Shape2;
typedef struct { unsigned char resource[144]; } Texture;

EXPORT int cuArray3DCreate_v2(void **array, const Shape *shape) {
    return (*array = allocated(sizeof(Shape))) ? (memcpy(*array, shape, sizeof(Shape)), 0) : 2;
}
EXPORT int cuArrayCreate_v2(void **array, const Shape2 *of) {
    Shape shape = {of->width, of->height, 0, of->format, of->channels, 0};
    return cuArray3DCreate_v2(array, &shape);
}
EXPORT int cuArray3DGetDescriptor_v2(Shape *shape, const Shape *array) { return *shape = *array, 0; }
EXPORT int cuArrayDestroy(void *array) { return free(array), 0; }
EXPORT int cuTexObjectCreate(void **texture, const void *resource) {
    return (*texture = allocated(sizeof(Texture))) ? (memcpy(*texture, resource, sizeof(Texture)), 0) : 2;
}
EXPORT int cuTexObjectGetResourceDesc(void *resource, const Texture *of) { return memcpy(resource, of, sizeof *of), 0; }
EXPORT int cuTexObjectDestroy(void *texture) { return free(texture), 0; }

/* --------------------------------------------------- OptiX --------------------------------------------------- */

typedef struct { void *result; int type; } Emitted;

static const char *error_name(int error) { return "error of the OptiX that is none"; }
static int nothing(void) { return 0; }
static int create_context(void *cuda, const void *options, void **context) { return *context = HANDLE, 0; }
static int create_module(void *context, const void *options, const void *pipeline, const char *code, size_t size,
                         char *log, size_t *logged, void **module) {
    return *logged = 0, *module = HANDLE, 0;
}
static int create_module_by_tasks(void *context, const void *options, const void *pipeline, const char *code,
                                  size_t size, char *log, size_t *logged, void **module, void **task) {
    return *task = HANDLE, create_module(context, options, pipeline, code, size, log, logged, module);
}
static int module_state(void *module, int *state) { return *state = 0x2364, 0; } /* compiled */
static int builtin_module(void *context, const void *options, const void *pipeline, const void *kind, void **module) {
    return *module = HANDLE, 0;
}
static int execute_task(void *task, void **more, unsigned size, unsigned *count) { return *count = 0, 0; }
static int create_groups(void *context, const void *descriptions, unsigned count, const void *options, char *log,
                         size_t *logged, void **groups) {
    for (unsigned i = 0; i < count; i++) groups[i] = HANDLE;
    return *logged = 0, 0;
}
static int stack_size(void *group, void *sizes) { return memset(sizes, 0, 28), 0; }
static int create_pipeline(void *context, const void *compiled, const void *linked, const void *groups, unsigned count,
                           char *log, size_t *logged, void **pipeline) {
    return *logged = 0, *pipeline = HANDLE, 0;
}
static int memory_usage(void *context, const void *options, const void *inputs, unsigned count, size_t sizes[3]) {
    return sizes[0] = sizes[1] = sizes[2] = 1024, 0;
}
static int build(void *context, void *stream, const void *options, const void *inputs, unsigned count, void *temporary,
                 size_t temporary_size, void *output, size_t size, uint64_t *handle, const Emitted *emitted,
                 unsigned emitted_count) {
    for (unsigned i = 0; i < emitted_count; i++) *(size_t *) emitted[i].result = 512;
    return *handle = (uint64_t) output, 0;
}
static int compacted(void *context, void *stream, uint64_t input, void *output, size_t size, uint64_t *handle) {
    return *handle = (uint64_t) output, 0;
}
static int pack_header(void *group, void *header) { return memset(header, 0, 32), 0; }

/* Entries by their positions in the table of OptiX 9.0 (ABI 105). */
EXPORT int optixQueryFunctionTable(int abi, unsigned options, void *keys, const void **values, void **table,
                                   size_t size) {
    if (abi != 105) return 1;
    for (size_t i = 0; i < size / sizeof(void *); i++) table[i] = nothing;
    table[0] = table[1] = error_name, table[2] = create_context, table[12] = create_module;
    table[13] = create_module_by_tasks, table[14] = module_state, table[16] = builtin_module;
    table[17] = execute_task, table[18] = create_groups, table[20] = stack_size, table[21] = create_pipeline;
    table[24] = memory_usage, table[25] = build, table[29] = compacted, table[40] = pack_header;
    return 0;
}
