// Stands in for CUDA's libraries on a machine without a GPU: memory of the device is the host's, work is done when it is asked for, and
// kernels are compiled for the CPU by `module.py`. It shows whether what the crate asks of CUDA is what it means; not how fast it is, nor
// what real hardware makes of work that overlaps.
//
// Signatures and numbers: the documentation of the driver API, NVRTC, cuBLAS and cuRAND. What is not here answers that it is not supported
// (`build.sh` makes that of all names that a program wants).
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <dlfcn.h>
#include <fstream>
#include <mutex>
#include <string>
#include <ucontext.h>
#include <unistd.h>
#include <vector>

struct CudaIndex { unsigned int x, y, z; };
struct HostKernel { const char *name; void (*call)(void **); };

extern "C" {
CudaIndex host_thread, host_block, host_block_size, host_grid_size;
}

namespace {

// Threads of a block, each with a stack of its own; the running one goes on until it ends or meets the others.
const size_t STACK = 128 << 10;
const HostKernel *running;
void **arguments;
std::vector<ucontext_t> contexts;
std::vector<char *> stacks;
std::vector<char> ended;
ucontext_t scheduler;
size_t current;
bool alone, met;
char warp_rooms[32][32 * 16];

CudaIndex place(size_t thread) {
    auto s = host_block_size;
    return {unsigned(thread % s.x), unsigned(thread / s.x % s.y), unsigned(thread / s.x / s.y)};
}

void thread_main() {
    running->call(arguments);
    ended[current] = 1;
}

void run_together(size_t threads) {
    while (stacks.size() < threads) stacks.push_back((char *)malloc(STACK));
    contexts.resize(threads);
    ended.assign(threads, 0);
    for (size_t t = 0; t < threads; t++) {
        getcontext(&contexts[t]);
        contexts[t].uc_stack.ss_sp = stacks[t];
        contexts[t].uc_stack.ss_size = STACK;
        contexts[t].uc_link = &scheduler;
        makecontext(&contexts[t], thread_main, 0);
    }
    for (bool left = true; left;) {
        left = false;
        for (size_t t = 0; t < threads; t++) {
            if (ended[t]) continue;
            current = t;
            host_thread = place(t);
            swapcontext(&scheduler, &contexts[t]);
            left |= !ended[t];
        }
    }
}

void run_alone(size_t threads) {
    for (size_t t = 0; t < threads; t++) {
        current = t;
        host_thread = place(t);
        running->call(arguments);
    }
}

void launch(const HostKernel *kernel, CudaIndex grid, CudaIndex block, void **parameters) {
    running = kernel;
    arguments = parameters;
    host_grid_size = grid;
    host_block_size = block;
    size_t threads = size_t(block.x) * block.y * block.z;
    met = false;
    alone = false;
    for (unsigned z = 0; z < grid.z; z++)
        for (unsigned y = 0; y < grid.y; y++)
            for (unsigned x = 0; x < grid.x; x++) {
                host_block = {x, y, z};
                if (alone) run_alone(threads); else run_together(threads);
                // Where no thread waited for another one, none will.
                alone = !met;
            }
}

// One launch, or one module, at a time.
std::mutex busy;

std::string environment(const char *name) {
    const char *value = getenv(name);
    if (!value) { fprintf(stderr, "%s is not set\n", name); abort(); }
    return value;
}

// The library of a module: of a file that is named, or of text.
void *loaded(const std::string &image) {
    const std::string named = "// host-file ";
    std::string folder = environment("SDIM_HOST_CUDA"), source, out, toolkit;
    if (image.compare(0, named.size(), named) == 0) {
        source = image.substr(named.size(), image.find('\n') - named.size());
        out = folder + "/" + source.substr(source.rfind('/') + 1) + ".so";
        std::string include = environment("CUDA_HOME") + "/include";
        toolkit = " -DHOST_TOOLKIT '-I" + include + "' '-I" + include + "/cccl'";
    } else {
        size_t hash = std::hash<std::string>()(image);
        source = folder + "/" + std::to_string(hash) + ".cu";
        out = source + ".so";
        std::ofstream(source) << image;
    }
    if (access(out.c_str(), R_OK) != 0) {
        // Other processes may do so, too.
        std::string part = out + "." + std::to_string(getpid());
        std::string command = "python3 '" + environment("SDIM_HOST_MODULE") + "' '" + source + "' '" + part + "'" + toolkit;
        if (system(command.c_str()) != 0 || rename(part.c_str(), out.c_str()) != 0) return nullptr;
    }
    void *library = dlopen(out.c_str(), RTLD_NOW);
    if (!library) fprintf(stderr, "%s\n", dlerror());
    return library;
}

float wide(uint16_t bits) { uint32_t w = uint32_t(bits) << 16; float f; memcpy(&f, &w, 4); return f; }

uint16_t rounded(float f) {
    uint32_t w;
    memcpy(&w, &f, 4);
    if (f != f) return uint16_t(w >> 16) | 0x40;
    return uint16_t((w + 0x7fff + ((w >> 16) & 1)) >> 16);
}

enum { R_32F = 0, R_16BF = 14 };

float get(const void *data, int type, size_t at) {
    return type == R_32F ? ((const float *)data)[at] : wide(((const uint16_t *)data)[at]);
}

}  // namespace

extern "C" {

void host_meet() {
    if (alone) { fprintf(stderr, "%s: threads wait for each other in some blocks alone\n", running->name); abort(); }
    met = true;
    size_t mine = current;
    swapcontext(&contexts[mine], &scheduler);
}

void *host_warp_room() { return warp_rooms[current / 32]; }

// --- the driver
int cuInit(unsigned) { return 0; }
int cuDriverGetVersion(int *v) { *v = 13000; return 0; }
int cuDeviceGet(int *device, int ordinal) { *device = ordinal; return ordinal == 0 ? 0 : 101; }
int cuDeviceGetCount(int *n) { *n = 1; return 0; }
// The two of the compute capability, and memory pools.
int cuDeviceGetAttribute(int *value, int attribute, int) {
    *value = attribute == 75 ? 9 : attribute == 76 ? 0 : attribute == 115 ? 1 : 0;
    return 0;
}
int cuDevicePrimaryCtxRetain(void **context, int) { *context = (void *)1; return 0; }
int cuDevicePrimaryCtxRelease_v2(int) { return 0; }
int cuCtxSetCurrent(void *) { return 0; }
int cuCtxGetCurrent(void **context) { *context = (void *)1; return 0; }
int cuCtxSynchronize(void) { return 0; }
int cuStreamCreate(void **stream, unsigned) { *stream = (void *)16; return 0; }
int cuStreamDestroy_v2(void *) { return 0; }
int cuStreamSynchronize(void *) { return 0; }
int cuStreamWaitEvent(void *, void *, unsigned) { return 0; }
int cuStreamIsCapturing(void *, int *status) { *status = 0; return 0; }
int cuEventCreate(void **event, unsigned) { *event = (void *)32; return 0; }
int cuEventRecord(void *, void *) { return 0; }
int cuEventSynchronize(void *) { return 0; }
int cuEventDestroy_v2(void *) { return 0; }
int cuMemAlloc_v2(void **p, size_t n) {
    *p = malloc(n ? n : 1);
    // What was not written is seen.
    memset(*p, 0xff, n);
    return *p ? 0 : 2;
}
int cuMemAllocAsync(void **p, size_t n, void *) { return cuMemAlloc_v2(p, n); }
int cuMemFree_v2(void *p) { free(p); return 0; }
int cuMemFreeAsync(void *p, void *) { free(p); return 0; }
int cuMemGetInfo_v2(size_t *free_bytes, size_t *total) { *free_bytes = *total = size_t(8) << 30; return 0; }
int cuMemsetD8_v2(void *p, unsigned char value, size_t n) { memset(p, value, n); return 0; }
int cuMemsetD8Async(void *p, unsigned char value, size_t n, void *) { memset(p, value, n); return 0; }
int cuMemcpyHtoD_v2(void *to, const void *from, size_t n) { memcpy(to, from, n); return 0; }
int cuMemcpyHtoDAsync_v2(void *to, const void *from, size_t n, void *) { memcpy(to, from, n); return 0; }
int cuMemcpyDtoH_v2(void *to, const void *from, size_t n) { memcpy(to, from, n); return 0; }
int cuMemcpyDtoHAsync_v2(void *to, const void *from, size_t n, void *) { memcpy(to, from, n); return 0; }
int cuMemcpyDtoD_v2(void *to, const void *from, size_t n) { memmove(to, from, n); return 0; }
int cuMemcpyDtoDAsync_v2(void *to, const void *from, size_t n, void *) { memmove(to, from, n); return 0; }
int cuDeviceGetDefaultMemPool(void **pool, int) { *pool = (void *)64; return 0; }
int cuMemPoolSetAttribute(void *, int, void *) { return 0; }
int cuGetErrorName(int, const char **text) { *text = "an error of the stand-in"; return 0; }
int cuGetErrorString(int, const char **text) { *text = "see its messages"; return 0; }
int cuModuleLoadData(void **module, const void *image) {
    std::lock_guard<std::mutex> guard(busy);
    *module = loaded((const char *)image);
    return *module ? 0 : 218;
}
int cuModuleUnload(void *) { return 0; }
int cuModuleGetFunction(void **function, void *module, const char *name) {
    auto kernel = (const HostKernel *)dlsym(module, "host_kernels");
    for (; kernel && kernel->name; kernel++)
        if (!strcmp(kernel->name, name)) { *function = (void *)kernel; return 0; }
    return 500;
}
int cuLaunchKernel(void *f, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz, unsigned, void *,
                   void **parameters, void **) {
    // As a device refuses them.
    if (!gx || !gy || !gz || !bx || !by || !bz || bx * by * bz > 1024 || gy > 65535 || gz > 65535) return 1;
    std::lock_guard<std::mutex> guard(busy);
    launch((const HostKernel *)f, {gx, gy, gz}, {bx, by, bz}, parameters);
    return 0;
}

// --- NVRTC: what it makes is the source
int nvrtcCreateProgram(void **program, const char *source, const char *, int, const char *const *, const char *const *) {
    *program = strdup(source);
    return 0;
}
int nvrtcCompileProgram(void *, int, const char *const *) { return 0; }
int nvrtcDestroyProgram(void **program) { free(*program); *program = nullptr; return 0; }
int nvrtcGetPTXSize(void *program, size_t *n) { *n = strlen((char *)program) + 1; return 0; }
int nvrtcGetPTX(void *program, char *out) { strcpy(out, (char *)program); return 0; }
int nvrtcGetProgramLogSize(void *, size_t *n) { *n = 1; return 0; }
int nvrtcGetProgramLog(void *, char *out) { *out = 0; return 0; }

// --- cuRAND, which candle opens with each device
int curandCreateGenerator(void **generator, int) { *generator = (void *)1; return 0; }
int curandDestroyGenerator(void *) { return 0; }
int curandSetPseudoRandomGeneratorSeed(void *, unsigned long long) { return 0; }
int curandSetStream(void *, void *) { return 0; }

// --- cuBLAS: C = alpha op(A) op(B) + beta C, of columns one after the other
int cublasCreate_v2(void **handle) { *handle = (void *)1; return 0; }
int cublasDestroy_v2(void *) { return 0; }
int cublasSetStream_v2(void *, void *) { return 0; }
int cublasSetWorkspace_v2(void *, void *, size_t) { return 0; }
int cublasGemmStridedBatchedEx(void *, int ta, int tb, int m, int n, int k, const void *alpha, const void *a, int at, int lda,
                               long long sa, const void *b, int bt, int ldb, long long sb, const void *beta, void *c, int ct, int ldc,
                               long long sc, int batches, int compute, int) {
    auto known = [](int type) { return type == R_32F || type == R_16BF; };
    // 68: sums of f32, which alpha and beta are, too.
    if (compute != 68 || !known(at) || at != bt || !known(ct) || (ct != at && ct != R_32F) || *(float *)beta != 0) return 15;
    if (lda < (ta ? k : m) || ldb < (tb ? n : k) || ldc < m) return 7;
    std::vector<float> left(size_t(m) * k), column(m);
    for (long long batch = 0; batch < batches; batch++) {
        for (int i = 0; i < m; i++)
            for (int l = 0; l < k; l++)
                left[size_t(l) * m + i] = get(a, at, batch * sa + (ta ? l + (long long)i * lda : i + (long long)l * lda));
        for (int j = 0; j < n; j++) {
            for (auto &v : column) v = 0;
            for (int l = 0; l < k; l++) {
                float w = get(b, bt, batch * sb + (tb ? j + (long long)l * ldb : l + (long long)j * ldb));
                for (int i = 0; i < m; i++) column[i] += left[size_t(l) * m + i] * w;
            }
            for (int i = 0; i < m; i++) {
                float value = *(float *)alpha * column[i];
                long long to = batch * sc + i + (long long)j * ldc;
                if (ct == R_32F) ((float *)c)[to] = value; else ((uint16_t *)c)[to] = rounded(value);
            }
        }
    }
    return 0;
}

}  // extern "C"
